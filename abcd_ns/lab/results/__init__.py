"""What experiments find: one schema of records, and how they are read.

`results` is the schema, `records` reads and writes it, `tables` and `style` show it.
"""
