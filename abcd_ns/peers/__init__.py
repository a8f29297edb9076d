"""What ABCD is compared with, built from the same engine."""
