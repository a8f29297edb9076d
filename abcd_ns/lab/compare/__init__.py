"""`abcd compare`: methods, numbers of blocks, options and sizes under one protocol, a process each."""
