"""Formulas of underwater acoustics, and the settings that choose among them."""
