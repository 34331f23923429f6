"""Tests of the pure core: no process, no socket, no sound."""
