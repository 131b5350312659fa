"""The tables computed anew from the database, by code that shares nothing with the program's."""
