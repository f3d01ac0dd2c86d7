"""The comparison with the paper, and with other methods, in one command: `python -m bench.paper --help`."""
