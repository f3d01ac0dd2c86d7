"""Command-line verbs of the worker."""
