"""Results for people: tables, comparison of two results, pictures, and the HTML report."""
