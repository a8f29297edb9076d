"""`abcd export`: a trained scene as files for other programs, whole or in parts.

`shown` picks the Gaussians from the stored blocks; abcd_ns.formats writes them.
"""
