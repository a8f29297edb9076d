"""What we do with the method: runs under one protocol, compared, varied, scaled up and made to fail."""
