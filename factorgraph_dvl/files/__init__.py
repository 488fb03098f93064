"""Files to trials and solutions, and back."""
