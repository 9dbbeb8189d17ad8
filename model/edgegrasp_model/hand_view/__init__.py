"""What each hand sees of the cloud in its own frame."""
