"""`abcd plan`: `forecast` reckons memory, blocks and time with the functions that training itself uses."""
