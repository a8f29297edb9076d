"""`abcd compare`: methods, numbers of blocks, prices, options and sizes under one protocol, a process each.

`command` makes the plan, `terrain` that of a synthetic terrain; `charts` and `pictures` show what came of it.
"""
