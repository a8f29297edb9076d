"""`abcd study`: one method with one thing varied, under one protocol.

`command` makes the plan, `charts` draws what came of it.
"""
