// Vertex stage of an example program: scene.glb in world space. GLSL ES 3.00. Define LK_VERTEX_COLOR where the mesh has
// COLOR_0, LK_NORMAL_MAP where its material has a normal texture, and LK_MORE_TEX_COORDS where textures use TEXCOORD_2 or
// TEXCOORD_3.

uniform mat4 uViewProjection;

in vec3 aPosition;
in vec3 aNormal;
in vec2 aTexCoord0;
in vec2 aTexCoord1;

#ifdef LK_NORMAL_MAP
in vec4 aTangent;
out vec4 vTangent;
#endif
#ifdef LK_VERTEX_COLOR
in vec4 aColor;
out vec4 vColor;
#endif
#ifdef LK_MORE_TEX_COORDS
in vec2 aTexCoord2;
in vec2 aTexCoord3;
out vec2 vTexCoord2;
out vec2 vTexCoord3;
#endif

out vec3 vPosition;
out vec3 vNormal;
out vec2 vTexCoord;
out vec2 vLightmap;

void main() {
  vPosition = aPosition;
  vNormal = aNormal;
  vTexCoord = aTexCoord0;
  vLightmap = aTexCoord1;
#ifdef LK_NORMAL_MAP
  vTangent = aTangent;
#endif
#ifdef LK_VERTEX_COLOR
  vColor = aColor;
#endif
#ifdef LK_MORE_TEX_COORDS
  vTexCoord2 = aTexCoord2;
  vTexCoord3 = aTexCoord3;
#endif
  gl_Position = uViewProjection * vec4(aPosition, 1.0);
}
