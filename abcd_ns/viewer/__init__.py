"""The viewer: what keeps strangers out of it, and the panel that shows blocks, progress and memory.

`guard` stands before the server, `panel` is what a user sees, `scenery` what lies in the scene.
"""
