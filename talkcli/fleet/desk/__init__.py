"""The operator's side of a fleet: commands and the library reach one robot or several through the broker."""
