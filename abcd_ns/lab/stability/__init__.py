"""`abcd stability`: where methods fail, small scenes that make them, and what ABCD does there."""
