"""Hardening: rounds of attack, fine-tuning and re-test, and the judgement whether that helped."""
