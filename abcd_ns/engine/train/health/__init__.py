"""What goes wrong in a block while it trains, by rules, and how it is noticed, repaired and told."""
