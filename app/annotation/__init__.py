"""The rules of rating and comparing, without any page: who gets which clip, and what a press does."""
