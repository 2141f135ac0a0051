"""Reference by ray casting, verification, and the price of acoustic terms."""
