"""`abcd check`: `survey` reads all there is, `rules` find fault with it."""
