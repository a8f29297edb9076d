"""`abcd study`: one method with one thing varied, under one protocol."""
