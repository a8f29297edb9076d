"""Training runs, each in a process of its own, under one protocol.

`runner` does a plan; `worker` or `terrain` is what runs in a job's process.
"""
