"""A ping to pictures and files."""
