"""`abcd plan`: what a run will need, before it begins."""
