"""RTK as a second projector and as a peer, in a process of its own.

`remote` is what the bench calls; `bridge` and `worker` run in RTK's Python, which may be another than ours.
"""
