"""What is measured of recordings and of results."""
