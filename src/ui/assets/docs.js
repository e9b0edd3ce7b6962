// The documentation page: Swagger UI over the contract of this service.
const meta = document.querySelector('meta[name="csrf"]');
window.ui = window.SwaggerUIBundle({
  url: '/openapi.yaml',
  dom_id: '#swagger-ui',
  deepLinking: true,
  presets: [window.SwaggerUIBundle.presets.apis],
  layout: 'BaseLayout',
  validatorUrl: null,
  requestInterceptor: request => {
    if (meta && meta.content) request.headers['X-CSRF-Token'] = meta.content;
    return request;
  },
});
