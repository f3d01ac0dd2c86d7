"""`python -m worker`: the worker verb, without the `splatct` command around it."""

import argparse
import sys

from worker.verbs import worker

parser = argparse.ArgumentParser(prog="python -m worker", description=worker.HELP)
worker.configure(parser)
sys.exit(worker.run(parser.parse_args()))
