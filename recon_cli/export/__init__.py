"""What is done to a scene between training and its files, and to one that comes from a file."""
