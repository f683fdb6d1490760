"""A training that is stopped at any moment goes on to the result that it would have had."""
