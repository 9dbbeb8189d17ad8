"""PyBullet clutter-removal trials."""
