"""What ABCD is, in torch: no nerfstudio, no user interface."""
