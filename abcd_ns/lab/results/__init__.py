"""What experiments find: records of runs, one schema, and how they are read: tables, findings, charts."""
