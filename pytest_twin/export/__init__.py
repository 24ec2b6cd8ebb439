"""Findings written as other simulators take them, with what each of them loses."""
