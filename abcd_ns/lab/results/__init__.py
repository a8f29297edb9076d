"""What experiments find: one schema of records, and how they are read."""
