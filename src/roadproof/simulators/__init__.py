"""Simulators behind one protocol: the embedded town here, others beside it. Nothing heavy is imported until it is opened."""
