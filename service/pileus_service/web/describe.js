// The API's description, shown by Swagger UI; its files are those that fastapi-offline brings.
window.SwaggerUIBundle({ url: "/openapi.json", dom_id: "#api", deepLinking: true, validatorUrl: null })
