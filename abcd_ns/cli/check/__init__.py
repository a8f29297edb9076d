"""`abcd check`: what training would refuse, and what is readable but doubtful.

`survey` reads all there is, `rules` find fault with it.
"""
