"""Command-line verbs of the server."""
