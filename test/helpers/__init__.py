"""What the tests of several rooms use: runs, recordings and messages made for them."""
