"""What we do with the method: runs under one protocol, compared, varied, scaled up and made to fail.

`job` says what a run is, `runs` carries it out, `results` keeps and shows what was found; a folder a command.
"""
