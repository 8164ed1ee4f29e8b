"""Simulators behind one protocol. Nothing heavy is imported until one is asked for."""
