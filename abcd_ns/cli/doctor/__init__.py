"""`abcd doctor`: `facts` looks, `command` judges."""
