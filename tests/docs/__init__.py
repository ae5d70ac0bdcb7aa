"""The pages of docs/ and the README: what they tell people to type works."""
