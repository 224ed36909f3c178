"""Networks: tables, pictures, export, and trips by edge."""
