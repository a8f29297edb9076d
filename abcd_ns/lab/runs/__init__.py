"""Training runs, each in a process of its own, under one protocol.

`experiment` carries out a plan, `runner` starts its jobs, `worker` is what runs in the process.
"""
