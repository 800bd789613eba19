"""Navigation by the height of the terrain below a vehicle."""
