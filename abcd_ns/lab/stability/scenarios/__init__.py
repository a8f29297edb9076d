"""The ways to fail, by kind; each is declared where it is carried out."""
