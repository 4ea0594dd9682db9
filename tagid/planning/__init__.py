"""What a recording will be worth before it is made: link budget, expected rates, and what to change."""
