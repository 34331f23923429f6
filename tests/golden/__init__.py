"""The exact help, errors, library and replies of `talk`. Refactoring must not change them."""
