"""`abcd stability`: where methods fail, small scenes that make them, and what ABCD does there.

`lab` trains; `training` and `captures` have the ways to fail.
"""
