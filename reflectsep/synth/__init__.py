"""Simulated objects and rigs with known truth. Nothing here knows the model that is fitted to the pictures."""
