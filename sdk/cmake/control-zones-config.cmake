# find_package(control-zones) gives the target control_zones::plugin.
get_filename_component(_cz_prefix "${CMAKE_CURRENT_LIST_DIR}/../../.." ABSOLUTE)
if(NOT TARGET control_zones::plugin)
  add_library(control_zones::plugin SHARED IMPORTED)
  set_target_properties(control_zones::plugin PROPERTIES
    IMPORTED_LOCATION "${_cz_prefix}/lib/libcontrol_zones_c.so.@VERSION@"
    IMPORTED_SONAME "libcontrol_zones_c.so.@SONAME@"
    INTERFACE_INCLUDE_DIRECTORIES "${_cz_prefix}/include")
endif()
set(control-zones_FOUND TRUE)
