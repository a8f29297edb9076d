"""`abcd doctor`: `facts` looks, `rules` judge."""
