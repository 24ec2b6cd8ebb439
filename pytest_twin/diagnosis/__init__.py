"""Diagnosis: locate model errors, identify the missing effects, fit them and test them."""
