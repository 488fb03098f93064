"""What is wrong with a trial, before and after it is solved."""
