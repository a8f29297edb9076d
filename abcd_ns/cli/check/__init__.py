"""`abcd check`: what training would refuse, and what is readable but doubtful.

`survey` reads all there is, `about_*` find fault with photos, cameras and points, `command` tells.
"""
