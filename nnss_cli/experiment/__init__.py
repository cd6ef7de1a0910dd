"""Runs: what they are, how they are executed and kept."""
