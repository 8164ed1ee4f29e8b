"""How the shipped drivers are made: an expert with privileged sight, the data it collects, imitation."""

from roadproof.training.expert import expert as expert
