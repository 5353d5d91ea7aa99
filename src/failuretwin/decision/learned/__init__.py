"""Diagnosis by networks trained on the digital twin. Needs the extra `learn`."""
