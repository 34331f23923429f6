"""Help, errors, library and replies, word for word. Refactoring must not change them."""
