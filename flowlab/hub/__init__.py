"""Datasets and policies on the Hugging Face Hub: pushed without what is private, pulled without trust."""
