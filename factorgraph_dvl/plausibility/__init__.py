"""What is wrong with the records of a trial, before it is solved."""
