"""What people look at: figures, previews, and the numbers under them."""
