"""Errors, argument checks, poses, compiled functions, threads and files. Knows no sonar."""
