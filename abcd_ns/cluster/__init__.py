"""Blocks trained at once, by workers in processes of their own, on this machine or others.

`Dispatcher` assigns blocks and takes back what became of them; forked processes' pipes or Ray carry both.
"""
