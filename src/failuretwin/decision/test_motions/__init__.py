"""Test motions: movements that are made to be told something, and what they tell."""
