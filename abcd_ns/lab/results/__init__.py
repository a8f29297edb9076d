"""What experiments find: one schema of records, and how they are read.

`run` and `results` are the schema, `tables`, `findings`, `frontier` and `style` make words and charts of it.
"""
