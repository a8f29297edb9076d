"""`abcd check`: `survey` reads all there is, `command` finds fault with it."""
