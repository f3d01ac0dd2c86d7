"""An engine that behaves as told: {"name": "fake {\"steps\": 20, \"pause\": 0.1, \"end\": \"bug\"}"} in scan.json.

It stands in for splatcore.scan, .reconstruct and .results; the process around it is the real one.
"""
