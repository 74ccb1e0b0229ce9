// Vertex stage of an example program: scene.glb in world space. GLSL ES 3.00.

uniform mat4 uViewProjection;

in vec3 aPosition;
in vec3 aNormal;
in vec2 aTexCoord0;
in vec2 aTexCoord1;

out vec3 vPosition;
out vec3 vNormal;
out vec2 vTexCoord;
out vec2 vLightmap;

void main() {
  vPosition = aPosition;
  vNormal = aNormal;
  vTexCoord = aTexCoord0;
  vLightmap = aTexCoord1;
  gl_Position = uViewProjection * vec4(aPosition, 1.0);
}
