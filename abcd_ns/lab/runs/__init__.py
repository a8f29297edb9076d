"""Training runs, each in a process of its own, under one protocol.

`experiment` carries out a plan, `runner` starts its jobs, `worker` or `terrain` is what runs in the process.
"""
