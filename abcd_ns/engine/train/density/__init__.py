"""Density control: which Gaussians are added, moved and removed, within a budget."""
