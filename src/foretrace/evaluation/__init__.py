"""Experiments, descriptions and pictures: questions put to predictors and data, and how answers are drawn."""
