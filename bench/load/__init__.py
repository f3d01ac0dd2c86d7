"""What a service does under load: how fast, how late, how large. `python -m bench.load --help`."""
