"""Hardening: rounds of attack, fine-tuning and re-test, and the judgement whether that helped."""

from roadproof.hardening.budget import HardeningBudget as HardeningBudget
from roadproof.hardening.harden import harden as harden
from roadproof.hardening.page import write_hardening as write_hardening
from roadproof.hardening.result import Hardened as Hardened
from roadproof.hardening.tuning import Tuning as Tuning
from roadproof.hardening.tuning import TuningBatch as TuningBatch
