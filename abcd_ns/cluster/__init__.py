"""Blocks trained at once, by workers in processes of their own, on this machine or others."""
