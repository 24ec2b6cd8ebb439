"""Readers and writers of files: the only package that reads or writes them."""
