"""`python -m server`: the server verb, without the `splatct` command around it."""

import argparse
import sys

from server.verbs import server

parser = argparse.ArgumentParser(prog="python -m server", description=server.HELP)
server.configure(parser)
sys.exit(server.run(parser.parse_args()))
