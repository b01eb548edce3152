"""Outputs: what writes results, and what reads them back."""
