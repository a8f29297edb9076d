"""`abcd plan`: what a run will need, before it begins.

`forecast` reckons memory, blocks and time with the functions that training itself uses.
"""
