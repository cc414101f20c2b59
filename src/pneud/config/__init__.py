"""Configurations: their models, and what they come to as parameters."""
