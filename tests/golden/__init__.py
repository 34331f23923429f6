"""The surface of `talk`, word for word: what no rebuilding of the inside may change without meaning to."""
