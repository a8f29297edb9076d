"""`abcd poses`: camera poses and points for a folder of photos, by pycolmap."""
