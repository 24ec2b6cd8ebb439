"""What a conversion keeps, changes and loses, from the models on both sides of it."""
