"""What a service survives: real parts, really killed. `python -m bench.faults --help`."""
