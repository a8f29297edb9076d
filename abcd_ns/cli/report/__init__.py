"""`abcd report`: one training run as one HTML page."""
