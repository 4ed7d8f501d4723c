// Opens the page without the token in its address; what stands behind # says which runs are open.
location.replace(location.pathname + location.hash);
