"""What the method is compared with, and what made the built-in demos."""
