"""`abcd check`: what training would refuse, and what is readable but doubtful."""
