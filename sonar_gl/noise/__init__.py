"""A ping without noise to a noisy one."""
