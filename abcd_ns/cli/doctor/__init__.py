"""`abcd doctor`: whether this machine and environment can train, and what to do where not.

`facts` looks, `rules` judge.
"""
