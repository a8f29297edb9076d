"""`abcd compare`: methods, numbers of blocks, options and sizes under one protocol, a process each.

`command` makes the plan; `charts` and `pictures` show what came of it.
"""
