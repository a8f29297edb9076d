"""`abcd compare`: ABCD and its peers on one scene, under one protocol, each in its own process.

`command` says which, `charts` and `pictures` show what came of it.
"""
