"""Runs jobs: claims one from the ledger, drives the engine as a subprocess, publishes its results.

The worker process itself never imports torch or numpy; only `worker.engine`, a process of
its own, does. The server imports `contract`, `ledger` and `jobfolder` from here, never the rest.
"""
