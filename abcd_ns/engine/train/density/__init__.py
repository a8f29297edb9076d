"""Density control: Gaussians are added, moved and removed, within a budget; full blocks are cut in two."""
