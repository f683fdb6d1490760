"""Everything that turns runs into evidence."""
