"""`abcd export`: a trained scene as .ply files, whole or in parts."""
