"""`abcd export`: `shown` picks the Gaussians from the stored blocks; abcd_ns.formats writes them."""
