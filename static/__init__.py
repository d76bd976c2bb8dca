"""What the page and the program bring as files: style, scripts, pictures, the built-in demos."""
